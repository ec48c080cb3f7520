"""Scoring result files: targets, errors, recalls, tables."""
