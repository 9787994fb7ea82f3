"""How do replicas of one bundle on one broker know each other, agree on parameters, and keep events in order?"""
