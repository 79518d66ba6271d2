"""The paper's tables and figures: experiments as data, run as units of work, reported with their statistics."""
