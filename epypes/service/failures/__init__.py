"""Events that failed in a service: kept, listed, run again, and opened in a notebook."""
