"""Mesh formats: each is read into parts with one look each."""
