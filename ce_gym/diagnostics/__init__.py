"""Reports on robots and environments: transmissions, levels, standing, and instructions of a step."""
