"""How a command line speaks and is spoken to: shared options, the frames that options name, messages, completion."""
