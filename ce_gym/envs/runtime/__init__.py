"""A task on a robot compiled into kernels, and the batch of environments that runs them."""
