"""What a capture is like before hours are spent on it: `inspection` measures, `findings` says what is wrong."""
