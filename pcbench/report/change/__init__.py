"""The change between epochs in texts, tables, maps, pictures and sheets of the change between epochs."""
