"""Pages, videos, contact sheets and tables made from results."""
