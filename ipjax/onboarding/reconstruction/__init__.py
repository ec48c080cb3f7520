"""From one photo to a mesh: by TripoSR, or without learned weights; a file a method, one record they all return."""
