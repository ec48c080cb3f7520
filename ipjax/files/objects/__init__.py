"""The object file: an onboarded object as one portable file."""
