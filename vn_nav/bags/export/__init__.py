"""Bags in the formats of other projects."""
