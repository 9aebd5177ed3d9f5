"""Files that want to do harm, given to every reader."""
