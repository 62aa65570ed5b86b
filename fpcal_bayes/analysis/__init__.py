"""Results that several commands show: a campaign with its history, and the doctor's findings."""
