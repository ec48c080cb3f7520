"""Cameras as their files describe them."""
