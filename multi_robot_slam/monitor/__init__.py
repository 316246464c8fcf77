"""Does what the robots send agree with what the filter assumes of them? Read, never changed."""
