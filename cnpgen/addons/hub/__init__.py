"""Publication of datasets: the card, the Croissant description, and repositories on the Hugging Face Hub."""
