"""Generated motion files of published layouts, one walk in each, and files that are refused."""
