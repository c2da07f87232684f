to go
end
