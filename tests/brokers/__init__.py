"""Which real brokers do the tests start, and how?"""
