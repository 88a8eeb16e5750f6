"""From materials to springs and masses."""
