"""Every file format: readers and writers of what `model` and `measure` define."""
