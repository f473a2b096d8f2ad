"""What a garment's file holds: objects, layers of thick cloth, pattern pieces, buttons, several garments, a body."""
