"""The page of a training run: its learning curves, and its present policy walking, while it trains and afterwards."""
