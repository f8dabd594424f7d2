"""Training of policies: learners, runs, evaluation, export. Needs the extra `train`."""
