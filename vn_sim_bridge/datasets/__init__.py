"""Pictures and pairs of pictures to learn from."""
