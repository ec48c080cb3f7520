"""What `ipjax` runs."""
