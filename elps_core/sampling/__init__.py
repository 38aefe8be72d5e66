"""The places where the global context enters local path sampling."""
