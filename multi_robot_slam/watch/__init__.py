"""The live view: what a fusion publishes, or has published, as a page in the browser."""
