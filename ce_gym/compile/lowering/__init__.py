"""Lowering of a traced function to vector code: graph, order, functions of vectors, one tile."""
