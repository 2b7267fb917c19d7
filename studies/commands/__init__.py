"""The studies' command lines."""
