"""The proof that a bundle computes what its notebook computed: replays under other conditions, compared."""
