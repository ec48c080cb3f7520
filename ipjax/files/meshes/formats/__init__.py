"""Mesh formats: each is read into parts, of one texture or one kind of colour each."""
