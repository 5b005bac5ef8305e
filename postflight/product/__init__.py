"""What an analyst is handed: tables, header, statistics and figures of a best estimated trajectory."""
