"""A training run: settings, folder, progress, checkpoints, page."""
