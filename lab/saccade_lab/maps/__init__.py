"""Attention maps: what the rows of the head attend to, over pictures and words, and how to draw it.

Where to read what: ``layout`` (where each camera's patches sit in T_vl), ``grid`` (where they lie on the
camera's frame), ``view`` (one observation, from the simulator, from pictures or from a file of backbone
features), ``summary`` (mass, entropy, overlap), ``occlusion`` (what moves the actions when a patch is taken
away), ``record`` (all that is known about one observation), ``sheet`` (the PNG) and ``page`` (the HTML page).
``saccade attention`` puts them together. Needs the extra ``sim``.
"""
