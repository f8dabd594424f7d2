"""What ties the joints of a cluster together, and its dependent coordinates as functions of the independent ones."""
