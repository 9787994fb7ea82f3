"""Replicas of one service: membership, and the parameters that all of them have."""
