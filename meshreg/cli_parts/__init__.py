"""The command line's rooms: what is said (console), how it is stopped (guard), the jobs."""
