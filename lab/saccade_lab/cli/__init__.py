"""The commands of the lab, found by ``saccade`` through the entry points ``saccade.commands``."""
