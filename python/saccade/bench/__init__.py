"""How long the head takes on this machine: timing, floors and a cost model."""
