"""The vision-language backbone: its sizes, inputs and features."""
