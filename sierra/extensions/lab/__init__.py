"""A lab: computers that are reached over SSH, without a scheduler and without a shared file system."""
