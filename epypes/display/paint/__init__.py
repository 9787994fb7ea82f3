"""How is a view painted, as SVG, as tables and as text?"""
