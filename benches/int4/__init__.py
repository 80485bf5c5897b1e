"""What int4 costs and saves: errors of actions, which layers are sensitive, memory and loading.

- ``accuracy``: every precision and both ways to round against float32.
- ``groups``: one group of layers at a time.
- ``size``: files, memory and loading at N1.5's published size.
- ``page``: the page of docs.
"""
