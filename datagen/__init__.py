"""Episodes by the thousand: `dipn-datagen`."""
