"""A view as SVG, as a page, as tables and as text."""
