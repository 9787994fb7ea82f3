"""What does EPypes cost beside hand-written code, in one interleaved run?"""
