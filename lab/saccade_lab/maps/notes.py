"""What sheet and page have in common: colours, and notes on what is missing."""

GROUP_COLOURS = {"state": "#c46210", "future": "#10739e", "action": "#6b3fa0"}
KIND_COLOURS = {"text": "#5b7083", "special": "#b3261e", "pad": "#c9ced3"}

NO_FUTURE = "This checkpoint has no future tokens (N = 0): only maps of state and action rows are shown."
NO_IMAGES = "This layout has no image tokens, so no map can be drawn on a picture."
NO_PICTURES = "The file contains no pictures: maps are drawn on white."
