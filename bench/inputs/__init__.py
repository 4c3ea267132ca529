"""What damaged and mistyped inputs lead to."""
