"""Weights of networks: found, fetched, checked, and read without running what is in them."""
