"""Evaluation: episodes and their figures."""
