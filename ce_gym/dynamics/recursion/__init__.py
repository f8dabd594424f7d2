"""Passes over the tree of bodies: kinematics, CE-ABA and CE-RNEA."""
