"""`saccade study answer`: the study of how many future tokens a policy needs, by training many policies."""
