"""Evaluation of policies: errors, falls, pushes, crossing, motors, transfer, MuJoCo, cards."""
