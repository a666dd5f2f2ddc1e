"""Images, videos and tables of a run, for people to look at. Every file appears whole or not at all."""
