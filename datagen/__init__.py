"""Make and look after data sets: `dipn-datagen`."""
