//! Packed linear layers, fused attention, norms and the private thread pool: the numerics of saccade, knowing nothing of GR00T.
