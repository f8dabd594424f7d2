"""Where exact transmissions matter: controllers, contacts and designs made on simplified levels, judged on exact."""
