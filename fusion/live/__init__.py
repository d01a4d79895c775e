"""Live server: devices send samples, a web page shows their tracks as they grow."""
