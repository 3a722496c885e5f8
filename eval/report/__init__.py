"""Reports in HTML, and our results beside the paper's."""
