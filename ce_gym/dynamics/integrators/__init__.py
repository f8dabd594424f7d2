"""Time-stepping methods: data that says how a step is made of stages."""
