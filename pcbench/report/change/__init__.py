"""What `pcbench change` says and draws: texts, tables, maps, pictures and sheets of the change between epochs."""
