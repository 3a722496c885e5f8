"""The networks DIPN, GN and VPG, and their losses."""
