"""`python -m benches.backbone`: the vision-language backbone against transformers, its memory, its errors."""
