"""Many loops at once: a campaign over a table of loops or a folder of recordings, on one machine or on a cluster."""
