"""Questions that need many replicates, on this machine or on a cluster, and the paper's week."""
