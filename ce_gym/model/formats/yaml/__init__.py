"""The project's own robot files: YAML beside a plain URDF."""
