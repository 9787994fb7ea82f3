"""Does a graph still do on a labelled set what it must?"""
