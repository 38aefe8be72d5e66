"""Local path sampling: one walk, one connection, one weight recursion [thesis 4.6.1]."""
