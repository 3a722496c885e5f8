"""One short loop and what it trains: `dipn-train`."""
