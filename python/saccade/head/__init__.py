"""The action head: its sizes, contexts, options, interventions and traces."""
