"""The live page in a browser: its content, its HTTP server and the drawn picture."""
