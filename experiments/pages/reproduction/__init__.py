"""The paper reproduced: claims, judgements and sections of one page."""
