"""Studies: thousands of independent replicates of one question, on this machine or on a cluster."""
