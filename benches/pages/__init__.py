"""Programs that write pages of docs: tables from measurements, pictures, what is known of robots."""
