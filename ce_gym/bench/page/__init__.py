"""All benchmarks on one page, and which figures of README and docs are stale."""
