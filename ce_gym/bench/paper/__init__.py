"""The figures of the constraint-embedding paper, drawn again."""
