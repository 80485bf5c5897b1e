"""How the derivative of the actions by the vision-language tokens is split: the names of its paths."""

# Paths from the vision-language tokens to the actions, over all Euler steps. Each path is in exactly one of
# these, so that their derivatives add up to the whole.
DIRECT = "direct"  # by state and action rows alone: it never leaves a future row
READ = "read by future rows"  # it enters the rows where a future row reads the tokens
DETOUR = "detour"  # it enters where a state or action row reads the tokens, and passes a future row later
PATHS = (DIRECT, READ, DETOUR)
ALL_PATHS = "all"
