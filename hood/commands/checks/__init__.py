"""What a command's words say beside each other, before anything is made."""
