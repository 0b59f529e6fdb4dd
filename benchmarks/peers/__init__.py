"""What a user would pick instead, each measured beside ours."""
