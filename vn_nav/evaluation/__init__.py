"""Evaluation: episodes, figures and reports."""
