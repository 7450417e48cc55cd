"""What people see while it runs: panel, status line, live page."""
