"""How long the head takes here, beside what this machine allows: timing, floors, and a cost model."""
