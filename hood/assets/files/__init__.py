"""Names of the embedded assets, and what all readers and writers of files share."""
