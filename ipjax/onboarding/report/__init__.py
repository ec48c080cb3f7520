"""What onboarding made of a mesh or a photo: measured (`findings`), drawn (`pictures`) and shown (`page`)."""
