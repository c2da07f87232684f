"""Setup: new projects, examples, the check of this machine, schemas for editors."""
