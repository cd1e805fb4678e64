"""Methods side by side: which jobs there are, how they are started, what came out."""
