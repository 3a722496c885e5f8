"""How the results in docs are made: one script per page, with a list of commands and the code that writes the page."""
