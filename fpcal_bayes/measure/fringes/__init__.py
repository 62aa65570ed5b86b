"""The interferometer backwards: from recorded irradiance to changes of the cavity length and their uncertainty."""
