"""What commands ask of a garment's file that is not one tidy sheet, and what they say of it."""
