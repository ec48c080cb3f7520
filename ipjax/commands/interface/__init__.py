"""What all commands share: options, reading the frames that they name, messages, completion."""
