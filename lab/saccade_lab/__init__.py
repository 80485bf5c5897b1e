"""Research on saccade's policies: simulation, training, maps, studies, and the model in torch."""
