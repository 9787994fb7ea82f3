"""Previews of values."""
