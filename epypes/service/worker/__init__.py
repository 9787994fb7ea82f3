"""The worker process of a service."""
