"""The Rao-Blackwellized particle filter, readable beside the paper."""
