"""What hands the field over between the excitation system and a controller."""
