"""From one photo to a mesh: by TripoSR, or without learned weights. A module per method; all return one record."""
