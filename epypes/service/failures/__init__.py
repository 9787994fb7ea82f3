"""What becomes of an event that failed: it is kept, listed, run again, and opened in a notebook."""
