"""Networks alone judged by groups of recordings."""
