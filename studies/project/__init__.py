"""What the project as a whole reaches."""
