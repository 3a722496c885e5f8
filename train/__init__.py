"""Train networks: `dipn-train`."""
